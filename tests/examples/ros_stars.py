"""A ROS 2 node that finds the star trails of the frames of a bag, or of any mono camera, and publishes them.

    glstar convert night -o night-bag --to ros2
    python tests/examples/ros_stars.py --ros-args -p use_sim_time:=true &
    ros2 bag play night-bag

It publishes /stars, a geometry_msgs/PolygonStamped of the middles of the trails, px, the brightest first, with the
stamp and the frame of the image.  Needs rclpy, which comes with ROS 2 (Humble or later), and glstar beside it.
"""

import sys

import numpy as np
import rclpy
from geometry_msgs.msg import Point32, PolygonStamped
from sensor_msgs.msg import Image

import glstar as gs

PIXEL_TYPES = {"mono8": np.uint8, "mono16": np.uint16}
BRIGHTEST = 50


def pixels_of(message):
    """Return the pixels of a mono image, whose rows may be padded, (height, width)."""
    kind = np.dtype(PIXEL_TYPES[message.encoding]).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    return np.ascontiguousarray(rows[:, : message.width * kind.itemsize]).view(kind)


def main(arguments=None):
    """Run until the node is stopped."""
    rclpy.init(args=arguments)
    node = rclpy.create_node("stars")
    publisher = node.create_publisher(PolygonStamped, "/stars", 10)

    def on_image(message):
        trails = gs.detect_trails(pixels_of(message))
        found = PolygonStamped(header=message.header)
        found.polygon.points = [Point32(x=float(x), y=float(y)) for x, y in trails.middle_px[:BRIGHTEST]]
        publisher.publish(found)
        now_s = node.get_clock().now().nanoseconds * 1e-9
        node.get_logger().info(f"{now_s:.3f} s: {len(trails)} stars")

    node.create_subscription(Image, "/camera/image_raw", on_image, 10)
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()


if __name__ == "__main__":
    main(sys.argv)
