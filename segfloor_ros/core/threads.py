"""How many threads the libraries use."""

from __future__ import annotations

import os

BLAS_VARIABLES = 'OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS'


def limit_threads() -> None:
    """Use one thread of BLAS whatever the environment says, since the number of threads changes the
    last digits of a result, and one of OpenCV unless the environment says otherwise; call it before
    they are imported.

    Matrices and images here are small: a second thread gains little on an idle machine, costs CPU
    time while it waits for work, and on a busy one the two wait for each other. The stages run side
    by side instead.
    """
    os.environ.update(dict.fromkeys(BLAS_VARIABLES, '1'))
    os.environ.setdefault('OPENCV_FOR_THREADS_NUM', '1')
