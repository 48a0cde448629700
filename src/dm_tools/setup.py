from setuptools import find_packages, setup

package_name = "dm_tools"

setup(
    name=package_name,
    version="0.1.0",
    packages=find_packages(exclude=["test"]),
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},  # tells `colcon test` to use pytest
    zip_safe=True,
    maintainer="Deformable mirror maintainers",
    maintainer_email="maintainers@deformable-mirror.example",
    description="The command dm, the bench console, recordings, security policies and generated documentation",
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            "dm = dm_tools.cli:main",
        ],
        "ros2cli.command": [
            "dm = dm_tools.ros2_command:DmCommand",
        ],
    },
)
