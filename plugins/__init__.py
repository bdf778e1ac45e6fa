"""Mitsuba plugins built on svu_mi; importing this package registers them."""

from svu_mi.plugins import registry

registry.load()
