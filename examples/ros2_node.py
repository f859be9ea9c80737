"""A ROS 2 node that publishes detections and radar points for every radar tensor.

    python examples/ros2_node.py runs/quickstart --frame-id radar

It needs ROS 2 with `vision_msgs` in radejax's environment; docs/ros2.md describes the topics.
"""

import click
import numpy as np

import radejax
from radejax.data.points import Points, cfar_points
from radejax.data.projection import project_tensor


def box_fields(detections, shift_z_m):
    """Yields position (z raised by `shift_z_m`), quaternion, size, class, score of every box."""
    for box in detections.to_list()[0]:
        half_yaw = box["yaw"] / 2
        quaternion = (0.0, 0.0, float(np.sin(half_yaw)), float(np.cos(half_yaw)))
        position, size = ([box[k] for k in names] for names in ("xyz", "lwh"))
        position[2] += shift_z_m
        yield position, quaternion, size, box["cls"], box["score"]


def point_bytes(points: Points) -> tuple[list[str], bytes]:
    """Returns the names of the float32 fields of a point cloud and its little-endian content."""
    names = ["x", "y", "z", "doppler_mps", "power_db"]
    return names, np.stack(points[:5], -1).astype("<f4").tobytes()


@click.command()
@click.argument("workdir", type=click.Path(exists=True))
@click.option("--frame-id", default="radar", help="Frame of the boxes and points.")
@click.option(
    "--box-z", default=0.7, help="z of the boxes' origin, the LiDAR; K-Radar: 0.7 m."
)
def main(workdir, frame_id, box_z):
    """Publish the detections of the run WORKDIR."""
    import rclpy
    from sensor_msgs.msg import PointCloud2, PointField
    from std_msgs.msg import Float32MultiArray
    from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

    rclpy.init()
    node = rclpy.create_node("radejax")
    radejax.enable_compilation_cache()
    detector = radejax.Detector.from_workdir(workdir).warmup()
    boxes = node.create_publisher(Detection3DArray, "detections", 10)
    clouds = node.create_publisher(PointCloud2, "points", 10)

    def publish(message):
        tensor = np.array(message.data, np.float32).reshape(detector.grid.shape_drea)
        projection = detector.grid.measured_channels(project_tensor(tensor))
        result = Detection3DArray()
        result.header.frame_id, now = frame_id, node.get_clock().now()
        result.header.stamp = now.to_msg()
        for position, quaternion, size, cls, score in box_fields(
            detector(projection), box_z
        ):
            found, kind = Detection3D(header=result.header), ObjectHypothesisWithPose()
            center, shape = found.bbox.center, found.bbox.size
            q = center.orientation
            kind.hypothesis.class_id, kind.hypothesis.score = cls, score
            center.position.x, center.position.y, center.position.z = position
            q.x, q.y, q.z, q.w = quaternion
            shape.x, shape.y, shape.z = size
            found.results.append(kind)
            result.detections.append(found)
        boxes.publish(result)
        names, data = point_bytes(cfar_points(projection, detector.grid))
        cloud = PointCloud2(header=result.header, height=1, point_step=20, data=data)
        cloud.width, cloud.row_step, cloud.is_dense = len(data) // 20, len(data), True
        cloud.fields = [
            PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
            for i, name in enumerate(names)
        ]
        clouds.publish(cloud)

    node.create_subscription(Float32MultiArray, "radar_tensor", publish, 10)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
