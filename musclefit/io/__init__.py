"""Files in and out: surfaces, landmarks, rigs, reports."""
