"""Whether the tests notice faults: twenty are planted, one at a time."""
