"""Commands of arcade-torch; every one is a dataclass whose fields are its options."""

from typing import Annotated

import tyro

Unless = Annotated[bool, tyro.conf.arg(help_behavior_hint="(yes, unless this is given)")]
"""A setting that is on by default, and off with ``--no-NAME``."""
