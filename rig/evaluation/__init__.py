"""The experiments of `rig eval`: shipped ones and files, run in several processes; results as tables, figures, JSON."""
