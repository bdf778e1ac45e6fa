"""Consistency checks of cameras, mesh, light and photographs."""
