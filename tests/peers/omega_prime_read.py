"""Reads an OSI trace with omega-prime, which validates it, and prints number, stamp, x, y and yaw of every object as JSON.

Runs in an environment of its own: `python omega_prime_read.py FILE.osi`.
"""

from __future__ import annotations

import json
import sys

import omega_prime

recording = omega_prime.Recording.from_file(sys.argv[1], validate=True)
table = recording.df.select("idx", "total_nanos", "x", "y", "yaw")
json.dump([list(row) for row in table.iter_rows()], sys.stdout)
