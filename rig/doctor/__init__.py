"""What is connected, in what state it is, and what to do about it; nothing here moves anything."""
