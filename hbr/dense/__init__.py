"""The rig's own retrieval: a dense filter over object and azimuth, the next best view, and the stopping rule."""
