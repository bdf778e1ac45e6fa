"""Folders that commands write to: one writer at a time, whole results, and who wrote which file.

A result is written into a draft, a hidden folder inside its folder, and put in its place when it
is whole. Killed at any moment, a command leaves the older result or the new one, never a mixture.
"""
