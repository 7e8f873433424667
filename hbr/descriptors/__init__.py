"""Descriptors of views: one interface, chosen by name. A catalog can store several descriptors for each view."""

from hbr.descriptors.base import Comparison, Descriptor, Packed
from hbr.descriptors.embedding import PREFIX
from hbr.descriptors.registry import descriptor, load_descriptor, load_model, loaded_models, names, register

__all__ = [
    "PREFIX",
    "Comparison",
    "Descriptor",
    "Packed",
    "descriptor",
    "load_descriptor",
    "load_model",
    "loaded_models",
    "names",
    "register",
]
