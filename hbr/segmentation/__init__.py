"""From a frame to the object in it: exposure and white balance, silhouette, box, and a crop of one scale."""

from hbr.segmentation.background import TRUSTED, Background
from hbr.segmentation.segment import CROP_PX, Box, Segmentation, segment

__all__ = ["CROP_PX", "TRUSTED", "Background", "Box", "Segmentation", "segment"]
