"""What the commands share: options, live display, questions, progress."""
