"""Descriptors of a view behind one small protocol, chosen by name; several may stand side by side in a catalog."""

from hbr.descriptors.base import Comparison, Descriptor
from hbr.descriptors.registry import PAPERS, descriptor, names
from hbr.descriptors.rows import unpack_rows

__all__ = ["PAPERS", "Comparison", "Descriptor", "descriptor", "names", "unpack_rows"]
