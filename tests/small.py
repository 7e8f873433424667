"""Settings of small frames, which take a quarter of the computing."""

SMALL = ("camera.width=320", "camera.height=240", "view.roi=[40, 0, 240, 240]")
