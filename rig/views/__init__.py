"""Views: capture, acceptance, description, and the empty-table image."""
