"""Folders of files that come with the packages and are no code: settings of the algorithms, suites."""

from pathlib import Path


def shipped(folder: str) -> Path:
    """
    Find a folder that stands at the top of a checkout and inside an installed package.

    :param folder: Name of the folder, such as ``"suites"``; ``setup.cfg`` installs it as ``sb3_por/shipped/<folder>``
    :return: Path of the folder
    """
    package = Path(__file__).parents[1]
    installed = package / "shipped" / folder
    return installed if installed.is_dir() else package.parent / folder
