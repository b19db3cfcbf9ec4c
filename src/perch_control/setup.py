"""Installs perch_control."""

from setuptools import find_packages, setup

PACKAGE = "perch_control"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Geometric and predictive flight control, and the perching mission",
    maintainer="The perch developers",
    maintainer_email="perch@users.noreply.github.com",
    license="Apache-2.0",
    packages=find_packages(exclude=["test", "test.*"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "controller = perch_control.controller_node:main",
            "mission = perch_control.mission_node:main",
        ],
    },
)
