"""Installs perch_autopilot."""

from setuptools import find_packages, setup

PACKAGE = "perch_autopilot"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Autopilots over a link, and Betaflight in the loop",
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
            "betaflight = perch_autopilot.betaflight_node:main",
            "mavlink = perch_autopilot.mavlink_node:main",
        ],
    },
)
