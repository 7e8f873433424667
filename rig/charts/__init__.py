"""Charts for reports and evaluations."""
