"""The bytes on the wire, and what both message schemas accept."""

import tracemalloc

import msgpack
import numpy as np
import pytest

from helpers.serving_fakes import GOAL, challenge, observation, states
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import UserError
from mme_vla.serving import pack, unpack
from mme_vla.serving.codec import check_size
from mme_vla.serving.requests import (
    AddBuffer,
    Infer,
    Request,
    RequestReader,
    Reset,
    released_keys,
)

ARRAY = np.array([[1, -2], [300, 4]], np.int16)
ARRAY_BYTES = (
    b"\x84"
    b"\xc4\x0b__ndarray__\xc3"
    b"\xc4\x04data\xc4\x08\x01\x00\xfe\xff\x2c\x01\x04\x00"
    b"\xc4\x05dtype\xa3<i2"
    b"\xc4\x05shape\x92\x02\x02"
)
IMAGE = np.zeros((16, 16, 3), np.uint8)

READER = RequestReader(ROBOMME_JOINT, 10)


def parse(message: object) -> Request:
    return READER.parse(message)


def raw_array(**changes: object) -> bytes:
    fields = {"__ndarray__": True, "data": b"\0" * 8, "dtype": "<i2", "shape": [2, 2], **changes}
    return msgpack.packb({key.encode(): value for key, value in fields.items()})


def test_arrays_and_scalars_have_the_protocols_bytes():
    assert pack(ARRAY) == ARRAY_BYTES
    assert pack({"reset": True}) == b"\x81\xa5reset\xc3"
    scalar = b"\x83\xc4\x0d__npgeneric__\xc3\xc4\x04data\x07\xc4\x05dtype\xa3|u1"
    assert pack(np.uint8(7)) == scalar
    assert np.array_equal(unpack(ARRAY_BYTES), ARRAY)
    assert unpack(scalar) == 7 and unpack(scalar).dtype == np.uint8


@pytest.mark.parametrize("dtype", ["<f4", "<f8", "|u1", "|b1", ">i4", "<U3", "|S2", "<f2"])
def test_every_dtype_that_is_sent_comes_back(dtype):
    array = np.array([[0, 1], [1, 0]]).astype(dtype)
    for sent in (array, array.T, array[:, :1], array[:0], array[0, 0]):
        back = unpack(pack({"x": [sent]}))["x"][0]
        assert np.array_equal(back, sent) and np.shape(back) == np.shape(sent)


@pytest.mark.parametrize(
    "value", [np.array([1j]), np.array([object()]), np.zeros(2, "i4,f4"), object(), {"x": {1}}]
)
def test_records_objects_and_complex_numbers_are_not_sent(value):
    with pytest.raises(UserError, match="cannot be encoded"):
        pack(value)


@pytest.mark.parametrize(
    "changes",
    [
        {"shape": [3, 2]},
        {"shape": [-2, -2]},
        {"shape": "ab"},
        {"shape": [2.0, 2]},
        {"data": b""},
        {"data": "text"},
        {"shape": [0, 2**62], "data": b""},
        {"shape": [2**40, 2**40]},
        {"shape": [1] * 40},
        {"shape": [True, 4]},
        *(
            {"dtype": dtype}
            for dtype in ("|O", "<c8", "|V4", "i4,f4", "nonsense", 7, None, "f" * 99)
        ),
    ],
)
def test_an_array_that_is_not_what_it_says_is_refused(changes):
    with pytest.raises(UserError, match=r"array|shape|bytes|dtype"):
        unpack(raw_array(**changes))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"hello world",
        ARRAY_BYTES[:-3],
        ARRAY_BYTES + b"\0",
        b"\x91" * 5000,
        b"\xdd\xff\xff\xff\xff",
        b"\xa2\xff\xff",
        msgpack.packb(msgpack.Timestamp(1)),
        b"\x81\xc0\xc0",
        b"\x81\x90\x01",
    ],
)
def test_bytes_that_are_no_message_are_refused(data):
    with pytest.raises(UserError):
        unpack(data)


def test_random_bytes_never_raise_anything_else():
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(3000):
        data = (
            bytearray(ARRAY_BYTES)
            if rng.random() < 0.5
            else bytearray(rng.bytes(rng.integers(1, 60)))
        )
        for _ in range(3):
            data[rng.integers(len(data))] = rng.integers(256)
        try:
            parse(unpack(bytes(data)))
        except UserError:
            refused += 1
    assert refused == 3000  # none of these is a request


def test_requests_are_recognised_by_their_keys():
    assert isinstance(parse({"reset": True}), Reset)
    added = parse(
        {"add_buffer": True, "images": IMAGE[None, None], "state": states(1), "exec_start_idx": 3},
    )
    assert isinstance(added, AddBuffer) and added.exec_start == 3 and len(added.frames) == 1
    native = parse(observation(IMAGE, IMAGE, states(1)[0], grounded_subgoal="pick at <3, 4>"))
    assert (
        isinstance(native, Infer)
        and not native.stored
        and native.subgoals == {"grounded_subgoal": "pick at <3, 4>"}
    )
    challenge_request = parse(challenge([IMAGE] * 2, [IMAGE] * 2, states(2), True))
    assert (
        isinstance(challenge_request, Infer)
        and challenge_request.first
        and challenge_request.goal == GOAL
    )
    assert np.array_equal(challenge_request.states, states(2))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"front_rgb_list": [IMAGE.astype(np.float32)]}, "front_rgb_list"),
        ({"front_rgb_list": [IMAGE] * 3}, "front_rgb_list has 3"),
        ({"front_rgb_list": []}, "front_rgb_list holds 0"),
        ({"front_rgb_list": [IMAGE] * 11}, r"holds 11 frames.*limits\.frames"),
        ({"front_rgb_list": "pictures"}, "front_rgb_list"),
        ({"front_rgb_list": [np.zeros((16, 1000, 3), np.uint8)]}, "narrow"),
        ({"front_rgb_list": [np.zeros((4, 4, 3), np.uint8)]}, "sides"),
        ({"wrist_rgb_list": [IMAGE[..., 0]]}, "wrist_rgb_list"),
        ({"joint_state_list": [np.full(7, np.nan, np.float32)]}, "finite"),
        (
            {"joint_state_list": [np.zeros(6)]},
            r"joint_state_list.*\[frames, 7\], got .* float64 \[6\]",
        ),
        ({"joint_state_list": [np.array(["a"] * 7)]}, "numbers"),
        ({"gripper_state_list": [None]}, "gripper_state_list"),
        ({"task_goal": 3}, "task_goal"),
        ({"task_goal": []}, "task_goal"),
        ({"task_goal": ["x" * 9999]}, "characters"),
        ({"is_first_step": 1}, "is_first_step"),
        ({"action_space": "ee_pose"}, "joint_angle"),
        ({"simple_subgoal": 4}, "simple_subgoal"),
    ],
)
def test_a_wrong_value_is_named(change, named):
    right = challenge([IMAGE], [IMAGE], states(1), True)
    parse(right)
    with pytest.raises(UserError, match=named):
        parse({**right, **change})


@pytest.mark.parametrize(
    "key", ["front_rgb_list", "wrist_rgb_list", "joint_state_list", "is_first_step"]
)
def test_a_missing_key_is_named(key):
    message = challenge([IMAGE], [IMAGE], states(1), True)
    del message[key]
    with pytest.raises(UserError, match=f"lacks the key '{key}'"):
        parse(message)


@pytest.mark.parametrize(
    "message",
    [None, [], 3, {}, {"reset": False}, {"reset": "yes"}, {b"reset": True}, {"add_buffer": True},
     {"add_buffer": False}, {"observation/image": IMAGE}],
)  # fmt: skip
def test_what_is_no_request_is_refused(message):
    with pytest.raises(UserError):
        parse(message)


def test_a_false_flag_alone_is_told_what_to_send():
    with pytest.raises(
        UserError, match=r"reset=false: no request\. Send reset=true, or an observation"
    ):
        parse({"reset": False})
    with pytest.raises(UserError, match="Did you mean 'observation/image'"):
        parse({"reset": False, "observation_image": IMAGE})


def test_false_flags_beside_an_observation_are_as_good_as_none():
    sent = observation(IMAGE, IMAGE, states(1)[0], reset=False, add_buffer=False)
    assert isinstance(parse(sent), Infer)
    assert isinstance(parse({**sent, "reset": True}), Reset)
    with pytest.raises(UserError, match="add_buffer='no' must be true or false"):
        parse({**sent, "add_buffer": "no"})


@pytest.mark.parametrize(
    "goal", ["\ud800", "pick \udfff up", None, 7, b"pick", [None], {"a": 1}, np.zeros(2)]
)
def test_a_prompt_that_is_no_text_is_refused_in_words(goal):
    for sent in (observation(IMAGE, IMAGE, states(1)[0], prompt=goal),
                 challenge([IMAGE], [IMAGE], states(1), True, task_goal=goal)):  # fmt: skip
        with pytest.raises(
            UserError, match=r"(prompt|task_goal) (must be a text|holds half of a surrogate pair)"
        ):
            parse(sent)


def values(message: object) -> int:
    if isinstance(message, dict):
        return 1 + sum(values(key) + values(value) for key, value in message.items())
    return 1 + (sum(map(values, message)) if isinstance(message, list) else 0)


@pytest.mark.parametrize(
    "message",
    [
        None,
        3,
        [],
        {},
        [[]] * 3,
        {"a": {"b": [1, 2.5, "x" * 40]}},
        list(range(-200, 70000, 7)),
        [2**40, -(2**40), 1e9],
        ["x" * n for n in (0, 31, 32, 255, 256, 65535, 65536)],
        [b"x" * n for n in (0, 255, 256, 65536)],
        {str(n): [] for n in range(70000)},
        [[[[[{}]]]]],
        [True, False, None],
    ],
)
def test_values_are_counted_as_they_are(message):
    data, count = msgpack.packb(message), values(message)
    check_size(data, count)
    if count > 1:
        with pytest.raises(UserError, match="more than"):
            check_size(data, count - 1)


def test_a_message_of_nothing_but_empty_maps_is_refused_before_they_are_made():
    many = 2**22
    for data in (b"\xdd" + many.to_bytes(4, "big") + b"\x80" * many, b"\xdf\xff\xff\xff\xff"):
        tracemalloc.start()
        with pytest.raises(UserError, match="more than 1048576 values"):
            unpack(data)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 2**20
    with pytest.raises(UserError, match="more than 1000 values"):
        # many small lists count as one large
        check_size(b"\xdc\x00\x40" + (b"\xdc\x00\x40" + b"\x80" * 64) * 64, 1000)


def test_a_first_message_of_the_longest_episode_passes():
    frames = 4096
    lists = (
        "front_rgb_list",
        "wrist_rgb_list",
        "front_depth_list",
        "wrist_depth_list",
        "joint_state_list",
        "gripper_state_list",
        "eef_state_list",
        "front_camera_extrinsic_list",
    )
    assert set(unpack(pack({key: [np.zeros(3, np.uint8)] * frames for key in lists}))) == set(lists)


def test_keys_of_another_library_are_answered_with_those_of_the_robot():
    """A robot of one's own has no observation/image."""
    arm = {
        "name": "arm",
        "cameras": {"head": {}},
        "memory_camera": "head",
        "state": {"width": 2},
        "action": {"width": 2},
    }
    reader = RequestReader(Embodiment.from_dict(arm), 10)
    with pytest.raises(UserError, match=r"observation/head") as error:
        reader.parse({"observation.images.head": IMAGE, "observation.state": [0.0, 0.0]})
    assert "observation/image" not in str(error.value)
    with pytest.raises(UserError, match=r"observation/head, … or head_rgb_list"):
        reader.parse({"reset": False})
    with pytest.raises(UserError, match=r"observation/front, … or front_rgb_list"):
        parse({"reset": False})


WHITE = np.full_like(IMAGE, 255)


@pytest.mark.parametrize("key", ["observation/front", "observation/image"])
def test_a_camera_has_the_key_of_its_name_and_the_released_one(key):
    sent = {"observation/state": states(1)[0], "prompt": GOAL, "observation/wrist": IMAGE}
    assert parse({**sent, key: WHITE}).views["front"].min() == 255
    with pytest.raises(UserError, match=f"{key} must be a uint8 image"):
        parse({**sent, key: WHITE.astype(np.float32)})
    with pytest.raises(UserError, match=r"lacks the key 'observation/image' \(an image of .*front"):
        parse(sent)
    both = {"observation/front": WHITE, "observation/image": WHITE}
    with pytest.raises(UserError, match="both images of the camera 'front': send one"):
        parse({**sent, **both})


def test_the_released_key_is_the_cameras_that_is_called_so():
    arm = {
        "name": "arm",
        "cameras": {"front": {}, "image": {}, "wrist": {}},
        "state": {"width": 2},
        "action": {"width": 2},
    }
    robot = Embodiment.from_dict(arm)
    assert released_keys(robot) == {"wrist": "observation/wrist_image"}
    sent = {"observation/state": np.zeros(2), "prompt": GOAL, "observation/wrist_image": IMAGE}
    sent["observation/image"] = WHITE
    with pytest.raises(UserError, match="lacks the key 'observation/front'"):
        RequestReader(robot, 10).parse(sent)
    views = RequestReader(robot, 10).parse({**sent, "observation/front": IMAGE}).views
    assert views["image"].min() == 255 and views["front"].max() == 0
