"""The command `rig`."""

import os

# The program multiplies small matrices while devices wait. A second thread of NumPy saves little there, and waits for
# milliseconds if another program uses the core. A variable that is set stays as it is.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
