MODULE egm
  ! EGM session of one mechanical unit. The same source for every unit: its UdpUc device has the unit's name (ROB_1...).
  ! ABB, Application manual Externally Guided Motion, 3HAC073318-001.

  ! External Motion Interface Data (topic Motion).
  CONST string CONFIGURATION := "rtcp";
  ! Time without a datagram after which the arm stops, s. The last speed reference stays in force until then.
  CONST num COMM_TIMEOUT := 0.2;
  ! Largest joint speed, degrees/s: what the arm may do. ABB's default of 1 caps every motion.
  CONST num MAX_SPEED := 120;
  ! Largest distance of a joint from where the session begins, degrees.
  CONST num MAX_DISTANCE := 360;
  ! Low pass on the speed contribution, Hz; 0 switches it off.
  CONST num LOW_PASS := 0;
  ! Period of the datagrams, ms: a multiple of 4.
  CONST num SAMPLE_RATE := 4;
  ! Factor on the position gain: 1 follows positions and speeds, 0 follows speeds alone.
  CONST num POSITION_GAIN := 1;
  ! Window of convergence of each joint, degrees.
  CONST egm_minmax WINDOW := [-0.5, 0.5];
  ! Time inside the window that ends EGMRunJoint, s. Long, because the end interrupts the motion.
  CONST num CONVERGENCE_TIME := 3600;
  ! Speed of the one move outside EGM.
  CONST speeddata START_SPEED := v50;

  VAR egmident session;
  VAR bool connected;
  VAR bool timeout_shown := FALSE;

  PROC main()
    VAR jointtarget here;
    ! The first motion after a restart must not be EGM: confirm the present position as a fine point.
    here := CJointT();
    MoveAbsJ here \NoEOffs, START_SPEED, fine, tool0;
    WHILE TRUE DO
      EGMReset session;
      EGMGetId session;
      EGMSetupUC ROB_ID, session, CONFIGURATION, RobName() \Joint \CommTimeout:=COMM_TIMEOUT;
      ! Keeps feedback going while EGMRunJoint is not active.
      EGMStreamStart session \SampleRate:=SAMPLE_RATE;
      connected := TRUE;
      WHILE connected DO
        run_joint;
      ENDWHILE
    ENDWHILE
  ERROR
    end_with_message;
  ENDPROC

  ! One EGMRunJoint. It returns after convergence, and after a lost connection with connected = FALSE.
  PROC run_joint()
    EGMActJoint session \J1:=WINDOW \J2:=WINDOW \J3:=WINDOW \J4:=WINDOW \J5:=WINDOW \J6:=WINDOW \LpFilter:=LOW_PASS \SampleRate:=SAMPLE_RATE \MaxPosDeviation:=MAX_DISTANCE \MaxSpeedDeviation:=MAX_SPEED;
    ! Without NoWaitCond: with it a timeout is fatal.
    EGMRunJoint session, EGM_STOP_HOLD \J1 \J2 \J3 \J4 \J5 \J6 \CondTime:=CONVERGENCE_TIME \PosCorrGain:=POSITION_GAIN;
    timeout_shown := FALSE;
  ERROR
    IF ERRNO = ERR_UDPUC_COMM THEN
      connected := FALSE;
      ! Shown once: without a PC this happens after every timeout.
      IF NOT timeout_shown TPWrite "EGM " + RobName() + ": no data from the PC, waiting";
      timeout_shown := TRUE;
      RETURN;
    ENDIF
    RAISE;
  ENDPROC

  PROC end_with_message()
    TPWrite "EGM " + RobName() + " stopped, ERRNO " \Num:=ERRNO;
    TPWrite "See the event log; then PP to Main and Start.";
    Stop;
  ENDPROC

ENDMODULE
