"""Reads the pages that icalib writes."""

from __future__ import annotations

import gzip
import json
import re
from base64 import b64decode
from typing import Any


def figures_of(page: str) -> dict[str, Any]:
    """The figures of a page by name, as plotly.js gets them."""
    (packed,) = re.findall('<script type="application/gzip" id="figures">([^<]*)</script>', page)
    return json.loads(gzip.decompress(b64decode(packed)))
