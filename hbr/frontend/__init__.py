"""From a frame to the object in it: exposure and white balance, silhouette, box, and a crop of one scale."""

from hbr.frontend.background import TRUSTED, Background
from hbr.frontend.sighting import CROP_PX, Box, Sighting, sight

__all__ = ["CROP_PX", "TRUSTED", "Background", "Box", "Sighting", "sight"]
