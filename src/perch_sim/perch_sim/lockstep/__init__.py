"""Order of a simulated flight, without ROS: when each participant works, and from which step on its results take effect.

`Schedule` moves packets between the vehicle and its participants; `LocalParticipant` is a component in this process. Over ROS
a participant may be in another process, with which the schedule exchanges only inputs and outputs.
"""

from perch_sim.lockstep.batches import Arrival
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.participant import Answer, LocalParticipant, Participant, local_servers
from perch_sim.lockstep.schedule import Owed, Schedule
from perch_sim.lockstep.tasks import BEGUN, START, Task, flight_tasks, is_slow

__all__ = ["BEGUN", "START", "Answer", "Arrival", "Codec", "LocalParticipant", "Owed", "Packet", "Participant", "Schedule", "Task",
           "flight_tasks", "is_slow", "local_servers"]
