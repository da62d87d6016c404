"""
Pin the newest versions that setup.cfg allows and that work together, in constraints.txt.

    python .ci/renew_constraints.py            rewrites the file and prints what has changed; then: make test
    python .ci/renew_constraints.py --check    exit code 1 if setup.cfg no longer allows a pinned version

pip resolves all extras in this interpreter; the comments and the order of the file stay. Packages that pip does not choose
here (the build of PyBullet for another platform) keep their version. Known vulnerabilities of the pinned versions are shown
by `pip-audit -r constraints.txt --no-deps --disable-pip`, which needs a network.
"""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
EXTRAS = ".[test,dev,ray,human]"
PIN = re.compile(r"^([\w.-]+)==([^\s;]+)", re.MULTILINE)


def normalize(name: str) -> str:
    """A package's name as indices compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def renew(text: str, versions: dict[str, str]) -> str:
    """
    :param text: Content of constraints.txt
    :param versions: Normalized name of a package: its new version; others keep theirs
    :return: New content
    """
    return PIN.sub(lambda pin: f"{pin[1]}=={versions.get(normalize(pin[1]), pin[2])}", text)


def changes(before: str, after: str) -> list[str]:
    """
    :return: A line for each pin that differs
    """
    old, new = dict(PIN.findall(before)), dict(PIN.findall(after))
    return [f"{name} {old[name]} -> {new[name]}" for name in old if old[name] != new[name]]


def resolve(*constraints: str) -> dict[str, str]:
    """
    :param constraints: More arguments of pip
    :return: Normalized name of a package: the version that pip would install
    :raises SystemExit: If the requirements contradict each other
    """
    command = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet", "--report", "-"]
    done = subprocess.run([*command, *constraints, EXTRAS], cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    installed = json.loads(done.stdout)["install"]
    return {normalize(one["metadata"]["name"]): one["metadata"]["version"] for one in installed}


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only resolve with the pins as they are")
    if parser.parse_args().check:
        resolve("-c", str(CONSTRAINTS))
        return
    before = CONSTRAINTS.read_text()
    after = renew(before, resolve())
    CONSTRAINTS.write_text(after)
    print("\n".join(changes(before, after)) or "nothing has changed")


if __name__ == "__main__":
    main()
