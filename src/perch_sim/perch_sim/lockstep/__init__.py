"""Order of a simulated flight, without ROS: when each participant works, and from which step on its results take effect.

`Schedule` moves packets between the vehicle and its participants; `LocalParticipant` is a component in this process. Over ROS
a participant may be in another process, with which the schedule exchanges only inputs and outputs.
"""

from perch_sim.lockstep.batches import Arrival
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.participant import Answer, LocalParticipant, Participant, local_servers
from perch_sim.lockstep.schedule import PendingInput, Schedule
from perch_sim.lockstep.tasks import PARTICIPANTS, START, START_DEADLINE, Task, flight_tasks, is_slow

__all__ = ["PARTICIPANTS", "START", "START_DEADLINE", "Answer", "Arrival", "Codec", "LocalParticipant", "Packet", "Participant",
           "PendingInput", "Schedule", "Task", "flight_tasks", "is_slow", "local_servers"]
