"""Focus a camera behind the mirror: by distance, by dioptre, and by its own images. See docs/camera.md."""

from dm_autofocus import CameraFocusClient

with CameraFocusClient() as camera:
    print("the camera focuses", camera.focus_range().message)
    by_distance = camera.focus_distance(12.0)  # m; 0 = infinity
    print(f"12 m takes a mirror of {by_distance.curvature:+.4f} 1/m")
    camera.focus_dioptre(0.1)  # 1 / distance, as libcamera and Android count
    found = camera.autofocus(region=(0.0, 0.2, 0.3, 0.6))  # left, top, width, height as shares of the image
    print(f"sharpest at {found.distance:.2f} m after {found.images} images")
    result, image, depth = camera.focus_stack()  # sharp everywhere, and metres for each pixel
    print(f"{100 * result.share:.0f} % of the pixels from {result.distance_near:.2f} to {result.distance_far:.2f} m")
