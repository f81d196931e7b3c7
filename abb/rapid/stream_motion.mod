MODULE stream_motion
  ! The motion task of every arm (T_ROB1, T_ROB2...): the same source, the unit's index is found at run time.

  ! A first point of a download within this distance is where the arm stands, degrees.
  CONST num AT_START := 0.1;
  ! MoveAbsJ takes the time of \T instead.
  CONST speeddata MOVE_SPEED := v1000;

  VAR num unit := 0;
  VAR intnum stop_interrupt;
  VAR bool stopped := FALSE;
  VAR bool offered;
  VAR num points;
  VAR num move_number;
  VAR num duration;
  VAR jointtarget target := [[0, 0, 0, 0, 0, 0], [9E+09, 9E+09, 9E+09, 9E+09, 9E+09, 9E+09]];

  PROC main()
    find_unit;
    IDelete stop_interrupt;
    CONNECT stop_interrupt WITH stop_requested;
    IPers stop_number, stop_interrupt;
    ! Here by ExitCycle after a stop. Started otherwise, the arm is not where the server counts from: it has to stop first.
    IF stopped THEN
      stop_done{unit} := stop_number;
    ELSE
      stop_done{unit} := -1;
    ENDIF
    stopped := FALSE;
    move_number := 0;
    IF COORDINATED THEN
      %"coordinate"%;
    ENDIF
    WHILE TRUE DO
      wait_for_offer;
      IF offered THEN
        IF points = 0 THEN
          ! Returns when the queue has room, long before the arm is there.
          move_to_target POINT_ZONE;
        ELSE
          move_path;
        ENDIF
      ENDIF
    ENDWHILE
  ERROR
    TPWrite "Streaming of " + RobName() + " stopped, ERRNO " \Num:=ERRNO;
    Stop;
  ENDPROC

  PROC find_unit()
    unit := 0;
    FOR u FROM 1 TO UNITS DO
      IF UNIT_NAMES{u} = RobName() unit := u;
    ENDFOR
    IF unit = 0 THEN
      TPWrite RobName() + " is not among the first UNITS of UNIT_NAMES in stream_shared.sys";
      Stop;
    ENDIF
  ENDPROC

  ! Between the two rendezvous the shared data is this task's to read. A timeout lets traps in, and is no error.
  PROC wait_for_offer()
    offered := FALSE;
    WaitSyncTask point_offered, sync_tasks \TimeOut:=ACCEPT_TIMEOUT;
    points := path_points;
    duration := target_duration;
    target.robax := targets{unit};
    WaitSyncTask point_copied, sync_tasks \TimeOut:=COPY_TIMEOUT;
    offered := TRUE;
  ERROR
    ! After COPY_TIMEOUT another task has not copied: no arm moves by this point.
    IF ERRNO = ERR_WAITSYNCTASK RETURN;
    RAISE;
  ENDPROC

  ! The path stays as it is until all arms were stopped: the server stops them before it collects the next.
  PROC move_path()
    VAR num at;
    VAR jointtarget here;
    here := CJointT();
    FOR p FROM 1 TO points DO
      at := (p - 1) * UNITS + unit;
      target.robax := path{at};
      duration := path_durations{p};
      IF p = points THEN
        move_to_target fine;
        ! In coordinated motion all tasks execute the same moves: no arm leaves its first one out.
      ELSEIF p > 1 OR COORDINATED OR NOT is_near(target.robax, here.robax, AT_START) THEN
        move_to_target POINT_ZONE;
      ENDIF
    ENDFOR
  ENDPROC

  ! With MultiMove Coordinated all arms are on one motion planner, and every move has the same number in all tasks.
  ! Called by name, because the module does not load without the option.
  PROC move_to_target(zonedata zone)
    IF COORDINATED THEN
      move_number := move_number MOD 9999 + 1;
      %"move_coordinated"% target, move_number, duration, zone;
    ELSE
      MoveAbsJ target \NoEOffs, MOVE_SPEED \T:=duration, zone, tool0;
    ENDIF
  ERROR
    RAISE;
  ENDPROC

  PROC forget_queue()
    StopMove;
    ClearPath;
    StartMove;
  ERROR
    ! Motors off or program stopped: T_STREAM starts the movement of all motion tasks when it can.
    IF ERRNO = ERR_STARTMOVE TRYNEXT;
    RAISE;
  ENDPROC

  TRAP stop_requested
    forget_queue;
    stopped := TRUE;
    ExitCycle;
  ENDTRAP

ENDMODULE
