"""The names in tfbus of tf2's answers; those without a counterpart have none."""

TRANSLATION = {
    "LookupException": "UnknownFrameError",
    "ConnectivityException": "DisconnectedError",
    "TransformException: disconnected": "DisconnectedError",
    "ExtrapolationException: future": "FutureExtrapolationError",
    "ExtrapolationException: past": "PastExtrapolationError",
    "ExtrapolationException: one sample, asked for the future": "FutureExtrapolationError",
    "ExtrapolationException: one sample, asked for the past": "PastExtrapolationError",
    "ExtrapolationException: no samples": "FutureExtrapolationError",
    "TF_OLD_DATA": "expired",
    "TF_SELF_TRANSFORM": "invalid",
    "TF_NO_CHILD_FRAME_ID": "invalid",
    "TF_NO_FRAME_ID": "invalid",
    "TF_NAN_INPUT": "invalid",
    "TF_DENORMALIZED_QUATERNION": "invalid",
}
