"""Light estimated from the photographs, where nobody has measured it."""
