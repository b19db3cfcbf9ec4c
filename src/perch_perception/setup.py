"""Installs perch_perception."""

from setuptools import find_packages, setup

PACKAGE = "perch_perception"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Target localisation, visual-inertial odometry, state estimation and powerline mapping",
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
            "vio = perch_perception.vio_node:main",
            "estimator = perch_perception.estimator_node:main",
            "target_localizer = perch_perception.target_localizer_node:main",
            "powerline_mapper = perch_perception.powerline_mapper_node:main",
        ],
    },
)
