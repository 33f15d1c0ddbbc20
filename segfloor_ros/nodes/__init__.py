"""The five ROS 2 nodes: parameters and topics around the stages."""

from segfloor_ros.threads import limit_blas_threads

limit_blas_threads()
