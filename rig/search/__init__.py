"""A search without its hardware: model, session, strategies, saved runs, replay."""
