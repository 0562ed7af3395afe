"""File formats of recordings: ROS 1 bags, SQLite and MCAP files of ROS 2, and the folders that contain such files.

All modules are internal: `tfbus.recording.open_recording` and `tfbus.recording.Recorder` choose among them.
"""
