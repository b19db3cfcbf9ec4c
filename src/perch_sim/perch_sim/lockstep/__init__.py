"""The order of a simulated flight, without ROS: who works when, and from which step on its results count.

`Schedule` moves packets between the vehicle and its participants; `LocalParticipant` is a component in this process. Over ROS
a participant is another process, of which the schedule only sees what it takes and what it gives.
"""

from perch_sim.lockstep.batches import Arrival
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.participant import Answer, LocalParticipant, Participant, local_servers
from perch_sim.lockstep.schedule import Owed, Schedule
from perch_sim.lockstep.tasks import BEGUN, START, Task, flight_tasks, is_slow

__all__ = ["BEGUN", "START", "Answer", "Arrival", "Codec", "LocalParticipant", "Owed", "Packet", "Participant", "Schedule", "Task",
           "flight_tasks", "is_slow", "local_servers"]
