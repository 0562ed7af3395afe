"""File formats of recordings: ROS 1 bags, SQLite and MCAP files of ROS 2, and the folders that hold them."""
