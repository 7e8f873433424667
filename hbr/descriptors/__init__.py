"""Descriptors of views: one interface, chosen by name. A catalog can store several descriptors for each view."""

from hbr.descriptors.base import Comparison, Descriptor, Packed
from hbr.descriptors.registry import descriptor, names, register

__all__ = ["Comparison", "Descriptor", "Packed", "descriptor", "names", "register"]
