"""Any message of each kind, for hypothesis."""

from __future__ import annotations

from hypothesis import strategies as st

from edge_runtime.ros2 import messages as ros

DOUBLES = st.floats(allow_nan=False, allow_infinity=False)
FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)
# A zero ends a text in CDR, and half a surrogate pair is no text.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=40)
UINT32 = st.integers(0, 2**32 - 1)

TIMES = st.builds(ros.Time, st.integers(-(2**31), 2**31 - 1), UINT32)
HEADERS = st.builds(ros.Header, TIMES, TEXTS)
VECTORS = st.builds(ros.Vector3, DOUBLES, DOUBLES, DOUBLES)
TWISTS = st.builds(ros.Twist, VECTORS, VECTORS)
QUATERNIONS = st.builds(ros.Quaternion, DOUBLES, DOUBLES, DOUBLES, DOUBLES)
COVARIANCES = st.lists(DOUBLES, min_size=36, max_size=36)
ODOMETRIES = st.builds(
    ros.Odometry,
    HEADERS,
    TEXTS,
    st.builds(ros.PoseWithCovariance, st.builds(ros.Pose, VECTORS, QUATERNIONS), COVARIANCES),
    st.builds(ros.TwistWithCovariance, TWISTS, COVARIANCES),
)
DRIVES = st.builds(ros.AckermannDrive, FLOATS, FLOATS, FLOATS, FLOATS, FLOATS)
STAMPED_DRIVES = st.builds(ros.AckermannDriveStamped, HEADERS, DRIVES)
IMAGES = st.builds(
    ros.Image,
    HEADERS,
    UINT32,
    UINT32,
    TEXTS,
    st.integers(0, 255),
    UINT32,
    st.binary(max_size=100),
)
MESSAGES = st.one_of(TWISTS, STAMPED_DRIVES, ODOMETRIES, IMAGES)
KINDS = st.sampled_from([ros.Twist, ros.AckermannDriveStamped, ros.Odometry, ros.Image])
