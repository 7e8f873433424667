"""Drawn benches that photographed objects are placed on: for evaluations, the simulated camera and tests."""
