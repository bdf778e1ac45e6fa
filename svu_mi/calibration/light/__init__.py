"""Light from the photographs themselves, where nobody has measured it."""
