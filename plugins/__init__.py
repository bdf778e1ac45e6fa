"""Mitsuba plugins of svu_mi, registered on import of this package."""

from svu_mi.plugins import registry

registry.load()
