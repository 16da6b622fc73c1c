"""The benchmarks, with one thread of OpenBLAS as in the command line."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
