"""Settings of small frames, which take a quarter of the computing."""

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
SMALL_WORDS = tuple(word for setting in SMALL for word in ("--set", setting))
SMALL_FILE = (
    'default_bench = "sim"\n[catalog]\npath = "catalog"\n[camera]\nwidth = 320\nheight = 240\n'
    "[view]\nroi = [40, 0, 240, 240]\n"
)
"""A configuration with these settings and with a catalog beside it."""
