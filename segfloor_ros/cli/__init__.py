"""The segfloor command."""

from segfloor_ros.processes import limit_blas_threads

limit_blas_threads()
