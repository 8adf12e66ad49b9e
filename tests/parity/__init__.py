"""Parity of ``rules="reference"`` with the published package, popgym-arcade 0.0.7 (extra
``parity``, ``make parity``).

Nothing of that package is copied: its games are called, their states translated to ours and back,
and both step side by side.
"""
