"""Simulated cell: arm, hand, table, object of cells and depth camera behind the ROS interface of the real one."""

from push_ident.nodes import end_quietly_while_loading

end_quietly_while_loading()
