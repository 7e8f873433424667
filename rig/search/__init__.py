"""A search without its hardware: model, session, strategies, stopping rules, saved runs, replay."""
