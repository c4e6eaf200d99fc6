"""`python -m jaximu` is the command `jaximu`."""

import sys

from jaximu.cli import main

sys.exit(main())
