"""Start the command as `python -m gsseg_core.cli`."""

import sys

from gsseg_core.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
