"""Installs perch_planner."""

from setuptools import find_packages, setup

PACKAGE = "perch_planner"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Perching trajectories: QP with global bound checking, and the powerline NLP",
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
            "perching_planner = perch_planner.perching_planner_node:main",
            "powerline_planner = perch_planner.powerline_planner_node:main",
        ],
    },
)
