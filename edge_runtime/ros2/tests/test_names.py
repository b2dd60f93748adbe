"""Keys and tokens: the forms that zenoh-bridge-ros2dds writes and parses."""

from __future__ import annotations

import re

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from edge_runtime.errors import UserError
from edge_runtime.ros2 import names
from edge_runtime.ros2.tests import second

# As the bridge's own format strings, in a regular expression.
BRIDGE_TOKEN = re.compile(r"@/([^/]+)/@ros2_lv/(MP|MS)/([^/]+)/([^/]+)/([^/]+)")


@pytest.mark.parametrize(
    ("namespace", "topic", "key"),
    [
        ("/", "cmd_vel", "cmd_vel"),
        ("/", "/cmd_vel", "cmd_vel"),
        ("/hunter01", "odom", "hunter01/odom"),
        ("hunter01", "camera/image_raw", "hunter01/camera/image_raw"),
        ("/a/b", "c", "a/b/c"),
        ("/hunter01", "/absolute/odom", "absolute/odom"),
    ],
)
def test_a_key_is_the_name_without_the_first_slash(namespace, topic, key):
    assert names.key(namespace, topic) == key


@pytest.mark.parametrize(
    "name", ["", "1a", "a/1", "a-b", "a//b", "a b", "*", "/**", "é", "a" * 201]
)
def test_what_is_no_ros_name_is_refused_in_one_line(name):
    with pytest.raises(UserError) as caught:
        names.key("/", name)
    assert "\n" not in str(caught.value)


def test_the_root_is_no_topic():
    with pytest.raises(UserError, match="names nothing"):
        names.key("/hunter01", "/")


@pytest.mark.parametrize(
    ("vehicle_id", "namespace"), [("hunter01", "/hunter01"), ("a-b", "/a_b"), ("7up", "/v7up")]
)
def test_every_vehicle_id_gives_a_namespace(vehicle_id, namespace):
    assert names.namespace_of(vehicle_id) == namespace


@given(st.from_regex(r"[A-Za-z0-9_-]{1,64}", fullmatch=True))
def test_any_vehicle_id_gives_a_valid_namespace(vehicle_id):
    names.check_ros_name(names.namespace_of(vehicle_id))


def test_a_publishers_token_by_the_letter():
    token = names.topic_token(
        "a1b2", names.PUBLISHER, "hunter01/cmd_vel", "geometry_msgs/msg/Twist", names.RELIABLE
    )
    assert token == (
        "@/a1b2/@ros2_lv/MP/hunter01§cmd_vel/geometry_msgs§msg§Twist/:1:0:0,10:typehash="
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a;"
    )


@pytest.mark.parametrize("type_name", names.TYPES)
@pytest.mark.parametrize("kind", [names.PUBLISHER, names.SUBSCRIBER])
def test_a_token_parses_as_the_bridge_parses_it(type_name, kind):
    token = names.topic_token("a1", kind, "x/y", type_name, names.BEST_EFFORT)
    zenoh.KeyExpr(token)  # raises for what Zenoh would not declare
    found = BRIDGE_TOKEN.fullmatch(token)
    assert found is not None
    zid, role, key, kind_of_message, qos = found.groups()
    assert (zid, role) == ("a1", kind)
    assert key.replace("§", "/") == "x/y"
    assert kind_of_message.replace("§", "/") == type_name
    keyed, reliable, durable, history, user_data = qos.split(":")
    assert (keyed, reliable, durable, history) == ("", "0", "0", "0,10")
    assert re.fullmatch(r"typehash=RIHS01_[0-9a-f]{64};", user_data)


@pytest.mark.parametrize("type_name", names.TYPES)
def test_the_hashes_are_the_second_librarys(type_name):
    assert second.STORE.hash_rihs01(type_name) == f"RIHS01_{names.TYPES[type_name]}"
