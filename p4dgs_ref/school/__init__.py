"""Classroom mode: a copy of the equations for students to fill in, a grader with held-back inputs, a teacher's key.

from p4dgs_ref import school
school.classroom("course")                      # course/student, course/key, course/README.md
print(school.text(school.grade("course")))      # points by equation
eq = school.load("course/student/offsets.py")   # the equation in a student's file, to be called and looked at
"""

from ..lazy import offer

_HOME = {
    "classroom": "room",
    "ClassroomError": "room",
    "grade": "grading",
    "load": "student",
    "text": "marks",
    "as_json": "marks",
    "as_csv": "marks",
    "write": "marks",
}
__all__ = sorted(_HOME)
__getattr__, __dir__ = offer(__name__, _HOME)
