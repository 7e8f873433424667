"""Drivers of servo, IMU, camera and rig head, each behind a small protocol."""
