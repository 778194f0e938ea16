"""Robot files (URDF, MJCF) to scenes."""
