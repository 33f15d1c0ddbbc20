"""Other nodes that broadcast the same frames as this one."""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped

from segfloor_ros.nodes.messages.diagnostics import Level
from segfloor_ros.nodes.messages.topics import PATIENCE_S
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.stage_node import AnyStageNode


class RivalWatch:
    """Finds frames of SLAM that another node broadcasts, too, or below another parent."""

    def __init__(self, node: AnyStageNode) -> None:
        self._node = node

    def __call__(self, found: TransformStamped) -> None:
        """Take in what another node has broadcast."""
        own: StereoSlamNodeSettings = self._node.settings
        parent, child = found.header.frame_id, found.child_frame_id
        ours = {own.base_frame: own.odom_frame} if own.publish_odom_tf else {}
        ours[own.odom_frame] = own.map_frame
        if not own.publish_tf or child not in ours:
            return
        me, others = self._node.get_name(), set()
        for topic in ('/tf', '/tf_static'):
            others |= {i.node_name for i in self._node.get_publishers_info_by_topic(topic)}
        others -= {me}
        if not others:
            return
        remedy = f'set publish_odom_tf of {me} to false where the other is to own it'
        if child == own.odom_frame:
            remedy = f'let one of both localise, or set publish_tf of {me} to false'
        elif parent != own.odom_frame:
            remedy = f'set base_frame of {me} to {parent}'
        self._node.reporter.diagnose(
            f'{child} on tf',
            f'{child} jumps: tf has it below {parent}, by {" or ".join(sorted(others))}, '
            f'and below {ours[child]}, by {me}; {remedy}, or stop the other',
            Level.ERROR,
            PATIENCE_S,
        )
