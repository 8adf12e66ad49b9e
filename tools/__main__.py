"""``python -m arcade_torch.tools`` is ``arcade-torch``."""

import sys

from arcade_torch.tools.cli import main

if __name__ == "__main__":
    sys.exit(main())
