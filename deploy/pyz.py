"""The installer as one file that Python runs: `install.pyz`. Same sources, same bytes."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import deploy.installer

NAME = "install.pyz"
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)
_MAIN = (
    "import sys\n\nif sys.version_info < (3, 8):\n"
    '    sys.stderr.write("error: Python 3.8 or newer is needed: try python3.8\\n")\n'
    "    sys.exit(2)\n\n"
    "from deploy.installer.__main__ import main\n\n"
    'if __name__ == "__main__":\n    sys.exit(main(sys.argv[1:]))\n'
)


def build_installer() -> bytes:
    """The bytes of `install.pyz`."""
    folder = Path(deploy.installer.__file__).parent
    members = {"__main__.py": _MAIN, "deploy/__init__.py": ""}
    for path in sorted(folder.glob("*.py")):
        members[f"deploy/installer/{path.name}"] = path.read_text()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, text in members.items():
            info = zipfile.ZipInfo(name, _FIRST_DAY)
            info.external_attr = 0o100644 << 16
            archive.writestr(info, text)
    return packed.getvalue()
