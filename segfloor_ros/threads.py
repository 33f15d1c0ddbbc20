"""How many threads linear algebra may use.

The matrices here are small: a second BLAS thread gains little on an idle machine, and on a
busy one the two wait for each other and everything takes several times as long. The stages run
side by side instead.
"""

from __future__ import annotations

import os

VARIABLES = ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS')


def limit_blas_threads() -> None:
    """Use one BLAS thread unless the environment says otherwise; call it before NumPy is
    imported.
    """
    for variable in VARIABLES:
        os.environ.setdefault(variable, '1')
