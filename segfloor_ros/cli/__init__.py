"""The segfloor command."""

from segfloor_ros.threads import limit_blas_threads

limit_blas_threads()
