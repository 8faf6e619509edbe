"""ROS 2 nodes around the other stages: they convert, call and publish. Importing one does nothing else."""
