"""Folders that commands write to: one writer at a time, exchanged in one step, and run ids.

A result is written into a draft, a hidden folder beside its own, and the two are exchanged.
"""
