"""Commands that are killed, and commands that meet in one folder."""
