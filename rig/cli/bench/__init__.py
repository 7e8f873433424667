"""Commands for the bench: setup, doctor, find, table, servo, configuration."""
