"""What every room needs: arrays in Dr.Jit, memory, progress, checks of arguments, files."""
