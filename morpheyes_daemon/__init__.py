"""The onboard daemon of a quadrotor whose stereo baseline changes in flight."""

import os

__version__ = "0.1.0"

LARGEST_PICTURE_PX = 40_000_000
"""Pixels; OpenCV refuses larger pictures by their header, before it allocates anything for them. Chosen: both images of
the largest camera that can be configured have 25 million."""
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(LARGEST_PICTURE_PX))  # read once, when cv2 is imported
