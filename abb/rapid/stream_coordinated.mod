MODULE stream_coordinated
  ! For MultiMove Coordinated, in every motion task; set COORDINATED in stream_shared.sys. All arms are on one motion
  ! planner then: moves of one number begin and end together.

  ! The motion tasks of sync_tasks. With three arms: {3} and T_ROB3.
  PERS tasks coordinated_tasks{2} := [["T_ROB1"], ["T_ROB2"]];
  CONST speeddata COORDINATED_SPEED := v1000;
  VAR syncident all_coordinated;

  ! Again after each stop: leaving the program's cycle does not end coordinated motion.
  PROC coordinate()
    SyncMoveUndo;
    SyncMoveOn all_coordinated, coordinated_tasks;
  ENDPROC

  PROC move_coordinated(jointtarget target, num number, num duration, zonedata zone)
    MoveAbsJ target \ID:=number \NoEOffs, COORDINATED_SPEED \T:=duration, zone, tool0;
  ENDPROC

ENDMODULE
