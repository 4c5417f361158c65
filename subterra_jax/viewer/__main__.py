"""`python -m subterra_jax.viewer`."""

import sys

from subterra_jax.viewer.cli import main

if __name__ == "__main__":
    sys.exit(main())
