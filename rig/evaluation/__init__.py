"""Evaluations as people run them: over processes, resumable, with results to read, plot and process further."""
