"""The virtual bench: a simulation of the mirror, its drive electronics and the interferometer.

It speaks the real wire protocols and writes real map files, so that driver and map reader run the code they run on
hardware. It shares no code with them: a simulation that used the model it tests would hide that model's mistakes.
"""
