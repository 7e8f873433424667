"""Jobs: one generator for each kind of work, from opening the bench to the recorded result.

A job yields events, and the remarks and results that the terminal, the browser and programs show. It asks its
questions through `rig.jobs.desk.Desk`, which each presenter implements.

Decision: docs/decisions/0002.
"""
