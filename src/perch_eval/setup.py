"""Installs perch_eval."""

from setuptools import find_packages, setup

PACKAGE = "perch_eval"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Flight reports, benchmarks and campaigns",
    maintainer="The perch developers",
    maintainer_email="perch@users.noreply.github.com",
    license="Apache-2.0",
    packages=find_packages(exclude=["test", "test.*"]),
    package_data={PACKAGE: ["*.js"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "recorder = perch_eval.recorder_node:main",
            "viewer = perch_eval.viewer_node:main",
            "composed = perch_eval.composed_node:main",
        ],
    },
)
