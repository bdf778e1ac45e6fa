"""Many captures by one command: a list, steps in processes of their own, and a page of all."""
