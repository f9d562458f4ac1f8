from setuptools import setup

package = "crash_coach_common"

setup(
    name=package,
    version="0.1.0",
    description="The common floor: the environment's contract, strict YAML, what every node does.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=["crash_coach_common", "crash_coach_common.ros"],
    package_data={},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
)
