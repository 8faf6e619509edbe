"""The simulated cell behind the ROS interface of the real one: arm, hand, table, object and depth camera."""
