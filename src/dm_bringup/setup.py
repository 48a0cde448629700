from pathlib import Path

from setuptools import find_packages, setup

package_name = "dm_bringup"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/launch", [str(path) for path in Path("launch").glob("*.*")]),
        (f"share/{package_name}/config", [str(path) for path in Path("config").glob("*.*")]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # tells `colcon test` to use pytest
    zip_safe=True,
    maintainer="Deformable mirror maintainers",
    maintainer_email="maintainers@deformable-mirror.example",
    description="Launch files, configurations and the registry of the suite's nodes",
    license="Apache-2.0",
)
