"""The agent network as an ONNX model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from crash_coach_common.contract import FloatArray, IntArray
from policy_pkg.export.about import About, Port
from policy_pkg.export.check import Step
from policy_pkg.policy import WeightArrays

# Old enough for runtimes of some years ago.
OPSET, IR_VERSION = 17, 8
METADATA = "crash_coach"  # the key of policy.json's text within the model
_DTYPES = {"float32": TensorProto.FLOAT, "int64": TensorProto.INT64}


def to_onnx(weights: WeightArrays, about: About) -> bytes:
    """The model's file: inputs and outputs as ``about`` says, which it carries as metadata."""
    graph = helper.make_graph(
        _nodes(about.hidden_size),
        "policy",
        [_value(port) for port in about.inputs],
        [_value(port) for port in about.outputs],
        [
            numpy_helper.from_array(array, name)
            for name, array in _constants(weights, about).items()
        ],
    )
    model = helper.make_model(
        graph,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="crash-coach",
    )
    helper.set_model_props(model, {METADATA: about.model_dump_json()})
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _nodes(hidden_size: int) -> list[onnx.NodeProto]:
    """Linear - ReLU - GRU - Linear on observation, last action and robot, both one-hot."""
    make = helper.make_node
    return [
        # Equal instead of OneHot, for which -1 is the last action; here it is none.
        make("Unsqueeze", ["last_action", "axis_1"], ["last_action_column"]),
        make("Equal", ["last_action_column", "action_numbers"], ["last_action_is"]),
        make("Cast", ["last_action_is"], ["last_action_one_hot"], to=TensorProto.FLOAT),
        make("Unsqueeze", ["robot", "axis_1"], ["robot_column"]),
        make("Equal", ["robot_column", "robot_numbers"], ["robot_is"]),
        make("Cast", ["robot_is"], ["robot_one_hot"], to=TensorProto.FLOAT),
        make("Concat", ["observation", "last_action_one_hot", "robot_one_hot"], ["x"], axis=1),
        make("Gemm", ["x", "fc1.weight", "fc1.bias"], ["fc1"], transB=1),
        make("Relu", ["fc1"], ["encoded"]),
        make("Unsqueeze", ["encoded", "axis_0"], ["encoded_step"]),
        make("Unsqueeze", ["hidden", "axis_0"], ["hidden_step"]),
        make(
            "GRU",
            ["encoded_step", "gru.input", "gru.recurrent", "gru.bias", "", "hidden_step"],
            ["", "next_hidden_step"],
            hidden_size=hidden_size,
            linear_before_reset=1,  # torch's: n = tanh(W x + r (U h + b))
        ),
        make("Squeeze", ["next_hidden_step", "axis_0"], ["next_hidden"]),
        make("Gemm", ["next_hidden", "fc2.weight", "fc2.bias"], ["q"], transB=1),
    ]


def _constants(weights: WeightArrays, about: About) -> dict[str, npt.NDArray[Any]]:
    linear = ("fc1.weight", "fc1.bias", "fc2.weight", "fc2.bias")
    bias = [_gates(weights[f"rnn.{name}"]) for name in ("bias_ih", "bias_hh")]
    return {
        **{name: weights[name] for name in linear},
        "gru.input": _gates(weights["rnn.weight_ih"])[None],
        "gru.recurrent": _gates(weights["rnn.weight_hh"])[None],
        "gru.bias": np.concatenate(bias)[None],
        "action_numbers": np.arange(about.n_actions, dtype=np.int64),
        "robot_numbers": np.arange(len(about.robots), dtype=np.int64),
        "axis_0": np.array([0], dtype=np.int64),
        "axis_1": np.array([1], dtype=np.int64),
    }


def _gates(torchs: FloatArray) -> FloatArray:
    """torch's gates r, z, n in ONNX's order: z, r, h."""
    reset, update, new = np.split(torchs, 3)
    return np.concatenate([update, reset, new])


def _value(port: Port) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(port.name, _DTYPES[port.dtype], port.shape)


def run_onnx(path: Path) -> Step:
    """The model in ``path`` on onnxruntime's CPU provider, one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def step(
        observation: FloatArray, last_action: IntArray, robot: IntArray, hidden: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        given = {
            "observation": observation,
            "last_action": last_action.astype(np.int64),
            "robot": robot.astype(np.int64),
            "hidden": hidden,
        }
        q, next_hidden = session.run(["q", "next_hidden"], given)
        return q, next_hidden

    return step
