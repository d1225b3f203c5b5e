"""The documentation builds as a site without a warning."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_documentation_builds_and_has_all_pages(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr[-3000:]
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")}
    built = {path.parent.name for path in tmp_path.glob("*/index.html")}
    assert pages - {"index"} <= built and (tmp_path / "index.html").is_file()
    keys = (tmp_path / "reference" / "index.html").read_text(encoding="utf-8")
    assert "outer.trust.level" in keys and "significance" in keys
    assert "class" in (example := (tmp_path / "extending" / "index.html").read_text(encoding="utf-8"))
    assert "Cells" in example and "--8&lt;--" not in example
