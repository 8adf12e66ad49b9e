"""A setting of a command that is on by default, and off with ``--no-NAME``."""

from typing import Annotated

import tyro

Unless = Annotated[bool, tyro.conf.arg(help_behavior_hint="(yes, unless this is given)")]
"""Its type: under ``--no-NAME`` the help says what holds without it."""
