from setuptools import setup

package = "crash_coach_console"

setup(
    name=package,
    version="0.1.0",
    description="The live console: a team, a recording or a training run as a web page.",
    maintainer="Crash Coach engineers",
    maintainer_email="team@crash-coach.dev",
    license="Apache-2.0",
    packages=["crash_coach_console", "crash_coach_console.ros"],
    package_data={"crash_coach_console": ["web/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml", "LICENSE"]),
    ],
    install_requires=["setuptools"],
    extras_require={"test": ["pytest"]},
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "console = crash_coach_console.command:main",
        ],
    },
)
