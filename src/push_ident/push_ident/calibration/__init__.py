"""How well camera, tool and outline agree with each other, from the contacts of pushes. No mechanics and no model of the object needed.

`contacts` finds the frames in which the tool certainly touches the object, `estimate` fits to them where camera and tool stand, `check`
compares that with what is configured, and names the push that would show what is not known yet.
"""
