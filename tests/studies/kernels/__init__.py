"""How fast and how exact the kernels are, and the whole way from files to a map."""
