"""`python -m drgs` is `drgs`."""

from drgs.cli import main

raise SystemExit(main())
