"""musclefit: foldover-free retargeting of layered musculoskeletal models, with a report that proves it."""
