"""The five ROS 2 nodes: parameters and topics around the stages, nothing else.

In: messages, joined by the stamp of their keyframe. Out: the topics of `messages.topics`.
The way in is one module per node; `shared` is what they have in common, `slam_*` the parts of
`stereo_slam`.
"""

from segfloor_ros.core.threads import limit_threads

limit_threads()
