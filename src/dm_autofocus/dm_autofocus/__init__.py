"""Focus for a camera behind the mirror: thin optics, sharpness of images, search of the sharpest focus.

None of it knows ROS, but for the convenience `client`.
"""
