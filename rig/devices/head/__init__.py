"""The rig head: a small board beside the platter that samples the IMU and keeps the bench safe."""
