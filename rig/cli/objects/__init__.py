"""Commands for objects: enroll, identify, evaluate, runs."""
