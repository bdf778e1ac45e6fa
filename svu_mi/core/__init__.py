"""Arrays in Dr.Jit, memory, progress, checks of arguments, and files."""
