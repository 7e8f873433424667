"""The events of running plans, and the sentences that describe them."""
