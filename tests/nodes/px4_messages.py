"""A package px4_msgs of a few messages, made for the tests with the generators of ROS 2 itself.

    px4_messages.py FOLDER

Classes, checks of types and serialisation are as in a px4_msgs that somebody has built, so that what the
tests say is said over DDS. The definitions are PX4's as far as anybody here looks at them: names, types and
constants, in their order, without what is not used. It needs compilers for C and C++.
"""

import contextlib
import functools
import io
import logging
import os
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest import mock

PACKAGE = "px4_msgs"

# Some have no version, some have 0, some a higher one: what the names of topics are made from.
DEFINITIONS = {
    "OffboardControlMode": """
uint64 timestamp
bool position
bool velocity
bool acceleration
bool attitude
bool body_rate
bool thrust_and_torque
bool direct_actuator
""",
    "TrajectorySetpoint": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
float32[3] position
float32[3] velocity
float32[3] acceleration
float32[3] jerk
float32 yaw
float32 yawspeed
""",
    "VehicleCommand": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint16 VEHICLE_CMD_NAV_RETURN_TO_LAUNCH = 20
uint16 VEHICLE_CMD_NAV_LAND = 21
uint16 VEHICLE_CMD_DO_SET_MODE = 176
uint16 VEHICLE_CMD_COMPONENT_ARM_DISARM = 400
float32 param1
float32 param2
float32 param3
float32 param4
float64 param5
float64 param6
float32 param7
uint32 command
uint8 target_system
uint8 target_component
uint8 source_system
uint16 source_component
uint8 confirmation
bool from_external
""",
    "VehicleCommandAck": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint32 command
uint8 result
uint8 result_param1
int32 result_param2
uint8 target_system
uint16 target_component
bool from_external
""",
    "VehicleLocalPosition": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint64 timestamp_sample
bool xy_valid
bool z_valid
bool v_xy_valid
bool v_z_valid
float32 x
float32 y
float32 z
float32 vx
float32 vy
float32 vz
float32 heading
bool xy_global
bool z_global
uint64 ref_timestamp
float64 ref_lat
float64 ref_lon
float32 ref_alt
float32 eph
float32 epv
bool dead_reckoning
""",
    "VehicleStatus": """
uint32 MESSAGE_VERSION = 1
uint64 timestamp
uint8 arming_state
uint8 ARMING_STATE_DISARMED = 1
uint8 ARMING_STATE_ARMED = 2
uint8 nav_state_user_intention
uint8 nav_state
uint8 NAVIGATION_STATE_MANUAL = 0
uint8 NAVIGATION_STATE_POSCTL = 2
uint8 NAVIGATION_STATE_AUTO_LOITER = 4
uint8 NAVIGATION_STATE_AUTO_RTL = 5
uint8 NAVIGATION_STATE_DESCEND = 12
uint8 NAVIGATION_STATE_OFFBOARD = 14
uint8 NAVIGATION_STATE_AUTO_TAKEOFF = 17
uint8 NAVIGATION_STATE_AUTO_LAND = 18
uint8 NAVIGATION_STATE_AUTO_PRECLAND = 20
bool failsafe
uint8 system_type
uint8 system_id
uint8 component_id
bool pre_flight_checks_pass
""",
    "VehicleLandDetected": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
bool freefall
bool ground_contact
bool maybe_landed
bool landed
""",
    "BatteryStatus": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint8 id
bool connected
float32 voltage_v
float32 remaining
uint8 warning
uint8 BATTERY_WARNING_LOW = 1
""",
    "VehicleAttitude": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
uint64 timestamp_sample
float32[4] q
""",
    "HomePosition": """
uint32 MESSAGE_VERSION = 0
uint64 timestamp
float32 x
float32 y
float32 z
bool valid_lpos
""",
    "FailsafeFlags": """
uint64 timestamp
bool angular_velocity_invalid
bool attitude_invalid
bool local_altitude_invalid
bool local_position_invalid
bool global_position_invalid
bool offboard_control_signal_lost
bool home_position_invalid
bool battery_unhealthy
""",
}


def compilers() -> tuple[str, str] | None:
    """Commands for C and C++; None where there are none, or nothing to compile Python's extensions with."""
    found = shutil.which("cc"), shutil.which("c++")
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    return (found[0], found[1]) if found[0] and found[1] and header.exists() else None


def build(folder: Path) -> Path:
    """Make the package; the folder that has to be on Python's path."""
    logging.getLogger("rosidl_cli").setLevel(logging.ERROR)  # wheels list each of their entry points twice
    with mock.patch.dict(os.environ):
        os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)  # where wheels have what apt has elsewhere
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            _generate(folder)
        _compile(folder)
    return folder / "py"


def _generate(folder: Path) -> None:
    """Write the sources, those of each generator into a folder of its own: names of files recur."""
    from rosidl_cli.command.translate.api import translate
    from rosidl_generator_c.cli import GenerateC
    from rosidl_generator_py.cli import GeneratePython
    from rosidl_parser import parser
    from rosidl_typesupport_c.cli import GenerateCTypesupport
    from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
    from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

    (folder / "msg").mkdir(parents=True)
    for name, text in DEFINITIONS.items():
        (folder / "msg" / f"{name}.msg").write_text(text.lstrip())
    files = translate(
        package_name=PACKAGE,
        interface_files=[f"{folder}:msg/{name}.msg" for name in DEFINITIONS],
        include_paths=[],
        output_format="idl",
        output_path=folder / "idl",
    )
    supports = ["rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c"]
    generators = {
        "c": GenerateC("c"),
        "py": GeneratePython("py", typesupport_implementations=["rosidl_typesupport_c"]),
        "fastrtps": GenerateFastRTPSCTypesupport("fastrtps"),
        "introspection": GenerateIntrospectionCTypesupport("introspection"),
        "dispatch": GenerateCTypesupport("dispatch", typesupport_implementations=supports),
    }
    # Each generator would parse every file again, and each time it takes as long as all the rest.
    with mock.patch.object(
        parser, "get_ast_from_idl_string", functools.cache(parser.get_ast_from_idl_string)
    ):
        for name, generator in generators.items():
            out = folder / name / PACKAGE
            out.mkdir(parents=True)
            generator.generate(PACKAGE, files, [], out)


def _compile(folder: Path) -> None:
    """Compile them: two libraries that ROS loads by their names, and the extension that brings them along."""
    import numpy as np
    from ament_index_python import get_package_prefix

    found = compilers()
    assert found is not None
    prefix = Path(get_package_prefix("rosidl_runtime_c"))
    includes = [folder / part for part in ("c", "fastrtps", "introspection", "dispatch")]
    includes += [prefix / "include", *(prefix / "include").iterdir()]
    includes += [Path(sysconfig.get_paths()["include"]), Path(np.get_include())]
    flags = ["-O0", "-w", "-fPIC", *(f"-I{path}" for path in includes)]

    def compiled(part: str) -> list[Path]:
        for command, suffix in zip(found, (".c", ".cpp"), strict=True):
            sources = sorted((folder / part).rglob(f"*{suffix}"))
            if sources:  # all in one, so that headers are read once, but for those whose names recur
                whole = folder / part / f"{part}{suffix}"
                apart = [source for source in sources if source.stem.endswith("__description")]
                whole.write_text("".join(f'#include "{each}"\n' for each in sources if each not in apart))
                _run(folder / part, command, *flags, "-c", whole, *apart)
        return sorted((folder / part).glob("*.o"))

    with ThreadPoolExecutor(2) as threads:
        parts = ("c", "py", "fastrtps", "introspection", "dispatch")
        objects = dict(zip(parts, threads.map(compiled, parts), strict=True))
    target = folder / "py" / PACKAGE
    ros = [f"-L{prefix / 'lib'}", f"-Wl,-rpath,{prefix / 'lib'}", "-Wl,-rpath,$ORIGIN", f"-L{target}"]
    ros += ["-Wl,--no-as-needed", "-lrosidl_runtime_c", "-lrcutils", "-lfastcdr", "-lrosidl_typesupport_c"]
    ros += ["-lrosidl_typesupport_fastrtps_c", "-lrosidl_typesupport_fastrtps_cpp"]
    ros += ["-lrosidl_typesupport_introspection_c"]
    names = {part: f"{PACKAGE}__rosidl_typesupport_{part}_c" for part in ("introspection", "fastrtps")}
    contents = {"introspection": ("c", "introspection"), "fastrtps": ("fastrtps",)}
    linked: list[str] = []
    for part, name in names.items():
        parts_in = [path for each in contents[part] for path in objects[each]]
        library = target / f"lib{name}.so"
        _run(
            folder,
            found[1],
            "-shared",
            f"-Wl,-soname,{library.name}",
            "-o",
            library,
            *parts_in,
            *linked,
            *ros,
        )
        linked = [*linked, f"-L{target}", f"-l{name}"]
    extension = target / f"{PACKAGE}_s__rosidl_typesupport_c{sysconfig.get_config_var('EXT_SUFFIX')}"
    bound = [*objects["py"], *objects["dispatch"]]
    _run(folder, found[1], "-shared", "-o", extension, *bound, "-Wl,--no-as-needed", *linked, *ros)


def _run(folder: Path, *command: object) -> None:
    done = subprocess.run([str(part) for part in command], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


if __name__ == "__main__":
    print(build(Path(sys.argv[1]).absolute()))
