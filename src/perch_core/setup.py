"""Installs perch_core and, beside it, the repository's configuration as `share/perch_core/config`."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "perch_core"
HERE = Path(__file__).resolve().parent  # the source, also where colcon runs a link to this file


def config_files() -> list[tuple[str, list[str]]]:
    """Every `config/**/*.yaml`, grouped by the folder it is installed into."""
    folders: dict[str, list[str]] = {}
    for file in sorted((HERE / "config").rglob("*.yaml")):
        relative = file.relative_to(HERE)
        folders.setdefault(f"share/{PACKAGE}/{relative.parent}", []).append(str(relative))
    return sorted(folders.items())


setup(
    name=PACKAGE,
    version="0.1.0",
    description="Maths, models and ROS conventions shared by every perch package",
    maintainer="The perch developers",
    maintainer_email="perch@users.noreply.github.com",
    license="Apache-2.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        *config_files(),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={"console_scripts": ["description = perch_core.description_node:main"]},
)
