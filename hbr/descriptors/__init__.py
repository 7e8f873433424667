"""Descriptors of views: one interface, chosen by name. A catalog can store several descriptors for each view."""

from hbr.descriptors.base import Comparison, Descriptor
from hbr.descriptors.registry import best, descriptor, names, register

__all__ = ["Comparison", "Descriptor", "best", "descriptor", "names", "register"]
