"""
Pin the newest versions that setup.cfg allows and that work together, in constraints.txt.

    python .ci/renew_constraints.py            rewrites the file and prints what has changed; then: make test
    python .ci/renew_constraints.py --check    exit code 1 if the pins contradict each other or setup.cfg

All extras are resolved by uv (pip install uv), for each Python and platform of TARGETS in turn, and each keeps to the versions
that were found for those before it: one version of a package serves them all. The comments and the order of the file stay, and
a package that no target needs any more keeps its pin. Nothing is installed. Known vulnerabilities of the pinned versions are
shown by `pip-audit -r constraints.txt --no-deps --disable-pip`; both need a network. Those that were found by hand are listed
in advisories.csv.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
CONSTRAINTS = ROOT / "constraints.txt"
EXTRAS = ("test", "dev", "docs", "demos", "hub", "human", "ray")
#: Without it, an abandoned release of MoviePy would be taken, which forbids no version of Pillow.
FLOORS = {"moviepy": "moviepy>=2"}
#: Oldest macOS that there are wheels of PyTorch for
MACOS = "14.0"
#: Python and platform as uv names them. The oldest Python comes first: fewer versions run on it.
TARGETS = tuple(
    (f"3.{minor}.9", platform) for minor in (10, 11, 12, 13) for platform in ("x86_64-manylinux_2_28", "aarch64-apple-darwin")
)
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


def resolve(python: str, platform: str, constraints: str) -> dict[str, str]:
    """
    :param python: Version of Python
    :param platform: Platform
    :param constraints: Content of a file of constraints
    :return: Normalized name of a package: the version that would be installed there
    :raises SystemExit: If the requirements contradict each other
    """
    command = [sys.executable, "-m", "uv", "pip", "compile", "setup.cfg", "--quiet", "--no-header", "--no-annotate"]
    command += [f"--extra={extra}" for extra in EXTRAS]
    command += [f"--python-version={python}", f"--python-platform={platform}"]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write(constraints)
        file.flush()
        command += ["--constraint", file.name]
        env = os.environ | {"MACOSX_DEPLOYMENT_TARGET": MACOS}
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"Python {python} on {platform}: {done.stderr}")
    return {normalize(name): version for name, version in PIN.findall(done.stdout)}


def newest() -> dict[str, str]:
    """
    :return: Normalized name of a package: its newest version that works on all targets together
    :raises SystemExit: If there is none
    """
    versions: dict[str, str] = {}
    for python, platform in TARGETS:
        so_far = FLOORS | {name: f"{name}=={version}" for name, version in versions.items()}
        versions |= resolve(python, platform, "\n".join(so_far.values()))
    return versions


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="only resolve with the pins as they are")
    before = CONSTRAINTS.read_text()
    if parser.parse_args().check:
        for python, platform in TARGETS:
            print(f"Python {python} on {platform}: {len(resolve(python, platform, before))} packages", flush=True)
        return
    after = renew(before, newest())
    CONSTRAINTS.write_text(after)
    print("\n".join(changes(before, after)) or "nothing has changed")


if __name__ == "__main__":
    main()
