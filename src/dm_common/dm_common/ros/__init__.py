"""What every node of the suite shares: the executor, worker threads, parameters, QoS profiles and diagnostics."""

#: Environment variable: process id of the parent that a node goes with, for one that is killed cannot stop its nodes.
SUPERVISOR = "DM_SUPERVISOR"
