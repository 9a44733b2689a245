"""Muscle architecture: where muscles hold on to bones, how their fibres run, and both carried by a map."""
