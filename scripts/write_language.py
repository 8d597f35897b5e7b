"""Writes appliance/skills/models/sentences/language.json, which `correct_text` goes by: counts of 4,000 sentences.

scripts/write_language.py [--check]
"""

import itertools
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

from appliance.learn.datasets.speech import sentences  # noqa: E402 - the tree is on the path only now
from appliance.skills._lib.learning import language, models  # noqa: E402 - the same

SEED, COUNT = 7, 4000
FILE = models.FOLDER / "sentences" / "language.json"


def main() -> int:
    """Write the file, or say whether it is as it would be written."""
    text = language.to_json(language.count(itertools.islice(sentences(SEED), COUNT)))
    if "--check" in sys.argv[1:]:
        return 0 if FILE.read_text(encoding="utf-8") == text else 1
    FILE.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
