"""Simulated cell: arm, hand, table, object of cells and depth camera behind the ROS interface of the real one."""
