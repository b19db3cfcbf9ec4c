"""Installs perch_sim."""

from setuptools import find_packages, setup

PACKAGE = "perch_sim"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="The simulated vehicle: plant, rotors, IMU, cameras, contact and timing",
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
            "vehicle = perch_sim.vehicle_node:main",
            "vio_model = perch_sim.vio_model_node:main",
        ],
    },
)
